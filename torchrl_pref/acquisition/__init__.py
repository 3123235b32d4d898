"""What a query is worth: acquisition functions, and their scores of many candidates at once."""
