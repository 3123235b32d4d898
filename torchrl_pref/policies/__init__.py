"""Learned strategies: networks that choose the next query."""
