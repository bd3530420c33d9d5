"""Ways to estimate one pose against a rendered map: the product's, and experiments that only the bench uses."""
