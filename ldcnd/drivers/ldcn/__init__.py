"""LDCN (Logosol) and NMC (J R Kerr): one binary protocol, dialects chosen by profile."""
