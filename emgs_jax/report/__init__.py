"""Reports for people: metrics, tables, pictures, gates, and the provenance of all of them."""
