"""Reports of stress tests as web pages."""
