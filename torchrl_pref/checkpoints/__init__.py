"""A trained policy on disk: written whole, read with suspicion, brought up to date."""
