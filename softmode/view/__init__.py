"""A live session with a soft body, to pull, pin and tune it while it moves; the browser tool is built on it."""
