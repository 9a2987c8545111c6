"""A page on which a person drives against an opponent: the server, the encounters, the page."""
