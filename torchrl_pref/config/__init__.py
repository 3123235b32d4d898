"""What may be typed: checks of settings before anything is made of them."""
