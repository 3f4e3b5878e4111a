"""ShapeSoft: bend a soft post into a given shape."""
