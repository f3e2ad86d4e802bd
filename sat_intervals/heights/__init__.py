"""Turn disparities into ground points and surface models. The only package that imports shareloc."""
