"""The reproduction of Zheng et al. (2023): calibration, tables, figures and the report, from finished runs."""
