"""DeepWrinkles' second half: low maps in, maps with wrinkles out."""
