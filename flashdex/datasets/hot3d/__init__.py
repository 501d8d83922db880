"""HOT3D: sessions of Aria and Quest 3."""
