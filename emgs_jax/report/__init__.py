"""What people look at: metrics, tables, pictures, gates, and where they come from."""
