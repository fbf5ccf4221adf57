"""Names and files become objects here: configurations, trainings, evaluations, sweeps."""
