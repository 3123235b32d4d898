"""How a policy learns: sessions, updates, what is logged of them."""
