"""What `robust_policies.py` is made of: a module a question."""
