"""The report: figures, animations, tables and the page that holds them."""
