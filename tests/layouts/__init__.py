"""Writers of dataset folders with synthetic content, one file a layout."""
