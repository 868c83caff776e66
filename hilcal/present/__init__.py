"""Reports of results: documents of text, tables and charts, and their renderers."""
