"""Health on recorded and simulated flights: changed or healthy, which rotor, rotor or weight, and what forbids more."""
