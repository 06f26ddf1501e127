"""The editor in the browser: a session of editing without any page, and a page around it."""
