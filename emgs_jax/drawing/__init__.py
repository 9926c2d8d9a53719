"""What pictures, pages and viewers draw with: colours, layers of a map, splats, the overview."""
