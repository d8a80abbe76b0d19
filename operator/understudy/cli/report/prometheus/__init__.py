"""The part of the report that comes from a Prometheus: queries, figures, histograms and its section of the page."""
