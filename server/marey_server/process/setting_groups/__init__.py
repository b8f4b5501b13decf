"""Groups of settings, which `marey_server.process.settings` joins."""
