"""A finished run for people: pictures as PNG files, and a report that any browser opens."""
