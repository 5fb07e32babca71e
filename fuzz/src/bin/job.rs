#![no_main]

entire_fuzz::text_target!(entire_fuzz::records::check_job);
