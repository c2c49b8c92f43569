"""The model's home: the net, the MHE problem and the generator that turns both into C. Build time only."""
