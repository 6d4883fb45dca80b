"""Stories of single objects in the report: plans, lanes and a sentence."""
