//! Step choice under a budget, and the reactive controllers that ours is compared against.
