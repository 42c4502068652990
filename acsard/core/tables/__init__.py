"""The texts of all findings, one file a subject."""
