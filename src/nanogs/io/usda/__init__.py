"""OpenUSD as text, `.usda`."""
