"""TACO: sequences of two hands, a tool and a target."""
