"""Shell: the door, a process of its own that ends the network's connections (`acsard door`)."""
