"""The estimators themselves, one assembly a file."""
