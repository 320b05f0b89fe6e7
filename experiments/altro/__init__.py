"""The benchmark problems of Altro.jl, rebuilt from their published specification."""
