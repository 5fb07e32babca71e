//! From inputs to seconds: the analytic cost model and PredNet behind one trait, with upper bound and out-of-range score.
