"""What is known of a person: beliefs over the weights ω, and how an answer changes them."""
