"""The report: one HTML file with the tables, the learning curves and a player of rounds; needs nothing else."""
