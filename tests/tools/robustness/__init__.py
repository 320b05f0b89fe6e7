"""How lqrsim takes hostile input: files, and the arguments of every public signature."""
