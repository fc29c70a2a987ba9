"""What the page offers for drives of this family alone, loaded by the name that the family object gives."""
