"""Configuration: conf/ composed with overrides, and every value checked."""
