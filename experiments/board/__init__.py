"""The robustness board of RealAIGym: the double pendulum, the runs, and a law that plans again on the way."""
