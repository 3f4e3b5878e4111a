"""What a body is: functions, points, surface, regions, and its file. NumPy alone."""
