"""What users do with solvers: compare, search, stress and look at them."""
