"""Tests of the live session and its page."""
