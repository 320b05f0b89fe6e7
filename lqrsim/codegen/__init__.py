"""From functions to machine code: symbolic derivatives, user functions, compiling, and the cache on disk."""
