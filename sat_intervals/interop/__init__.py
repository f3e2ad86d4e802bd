"""Work with other photogrammetry tools: a plugin for CARS, exports to CARS, ASP, s2p and OTB."""
