"""Settings files of the package; a package of its own so that every kind of installation finds them."""
