"""Files of FlashDexRetarget: npz clips and packs of motions."""
