"""Work with other tools: a plugin for CARS, exports to CARS, ASP, s2p and OTB, STAC items."""
