"""A second engine, DART, as another truth than MuJoCo."""
