"""The least-time problems of dynobench: their numbers, how they are stated for lqrsim, and a check without lqrsim."""
