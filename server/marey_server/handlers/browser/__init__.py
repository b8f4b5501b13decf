"""Resources of the browser: its sign-in, and the pages."""
