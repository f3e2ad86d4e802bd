"""Other tools of photogrammetry: a method of CARS, exports to CARS, ASP, s2p and OTB."""
