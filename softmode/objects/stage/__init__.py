"""Objects from OpenUSD stages."""
