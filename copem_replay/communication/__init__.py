"""When each list arrives, and the instants at which the receiver fuses."""
