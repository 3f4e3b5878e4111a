"""Newton's iteration on the device: search, rigid start, rounds, one launch. It knows no state of a scene."""
