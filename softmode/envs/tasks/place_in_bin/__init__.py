"""PlaceInBin: put a soft toy into a bin."""
