"""FlashSAC losses, reward scale and updates; they know no environment."""
