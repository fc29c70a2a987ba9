"""For those who run ldcnd: certificates and access, and a line's bytes for Wireshark."""
