"""How soon, how far away, how accurate, and would it have braked: definitions and sums."""
