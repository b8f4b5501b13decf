"""Archives of datasets: writing, extraction, import, and the copies between servers that use them."""
