"""A simulated Universal Robots controller, as it is seen from the network."""
