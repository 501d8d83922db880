"""Networks, exploration and policy of FlashSAC; they know no environment."""
