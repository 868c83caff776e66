"""The report as one HTML page that needs nothing else: parts, sections, template."""
