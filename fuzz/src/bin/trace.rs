#![no_main]

entire_fuzz::text_target!(entire_fuzz::traces::check_trace);
