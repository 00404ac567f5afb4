"""Where posteriors are high: guesses from the readings, and climbs from many starts."""
