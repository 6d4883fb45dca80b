"""How far off the lists are: statistics that add up, and the metrics made of them."""
