"""Write ``report.html``, a self-contained page of a finished run for any browser."""
