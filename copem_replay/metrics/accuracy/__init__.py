"""Accuracy of lists: statistics that add up, and the metrics made of them."""
