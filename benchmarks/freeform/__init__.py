"""FreeForm's tables and figures, with softmode and with what it is compared to: `python -m benchmarks.freeform`."""
