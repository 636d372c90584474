"""What rays and first-order data say of a lens."""
