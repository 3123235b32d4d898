"""What can be answered, and how likely each answer is."""
