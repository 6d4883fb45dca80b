"""Braking: whether the ego, braking when it knew, stays clear of the object. An open-loop counterfactual."""
