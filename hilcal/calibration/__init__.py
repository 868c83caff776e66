"""An identified model put to use: where the tool is, and how to put it where it is asked to be."""
