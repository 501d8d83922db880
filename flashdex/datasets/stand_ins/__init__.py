"""What a pickle from outside may build: stand-ins, made into values afterwards.

No object of a library is ever handed to the pickle machine. Each allowed name is a
class of this package that only keeps what it is given; its ``value`` then builds plain
values from checked sizes and indices. So no name can be called to an effect, and no
class can be changed for the next file.
"""
