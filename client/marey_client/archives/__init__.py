"""Archives of datasets: writing, extraction, import, and copies between servers by means of archives."""
