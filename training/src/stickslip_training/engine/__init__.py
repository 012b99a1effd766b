"""One way to train a network, whatever it learns."""
