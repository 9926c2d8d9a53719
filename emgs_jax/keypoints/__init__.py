"""Points that can be told apart in an image: found, matched with those of another image, and what poses follow."""
