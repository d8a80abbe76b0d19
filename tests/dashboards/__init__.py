"""Pictures of the chart's dashboards: ``scripts/dashboards``."""
