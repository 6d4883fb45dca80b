"""Braking: would the ego, braking when it knew, have stayed clear of the object? An open-loop counterfactual."""
