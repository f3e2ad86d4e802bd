"""Find out what a pair needs before its tiles: search range, local ranges, vertical parallax, statistics."""
