"""Draw pictures (PNG) and an HTML report of a finished run."""
