"""Hand models that data sets record parameters of: MANO, UmeTrack, MyoHand."""
