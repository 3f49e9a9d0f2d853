"""Pages for the browser, a parcel's and a survey's, each one file; their scripts and style come from ``web``."""
