"""Lists of units: where each unit stands, what it can see, which errors it makes (PEM)."""
