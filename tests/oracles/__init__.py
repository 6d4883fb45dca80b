"""The same figures, computed plainly and slowly."""
