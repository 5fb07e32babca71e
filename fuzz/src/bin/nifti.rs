#![no_main]

entire_fuzz::volume_target!(Nifti);
