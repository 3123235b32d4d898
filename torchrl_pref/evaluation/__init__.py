"""Strategies beside each other on the same humans: runs, statistics, tables, figures."""
