"""The settings files that come with the package; this file makes them findable however it is installed."""
