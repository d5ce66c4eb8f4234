"""PDM-Closed's plan with proposals that a car can drive from where it is, as it moves."""
