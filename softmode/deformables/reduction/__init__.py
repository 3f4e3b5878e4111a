"""From an object to a reduced body: quadrature, eigenmodes, static responses, functions, cubature, cache, report."""
