"""Studies: real people answer, and nothing that they said is ever lost."""
