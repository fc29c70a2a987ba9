"""Changes safety-relevant code and looks whether a test notices it: `make mutants`."""
