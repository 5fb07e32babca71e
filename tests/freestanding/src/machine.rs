//! The program's replacement for an operating system's library: an entry point, two system calls, an arena,
//! the memory functions that compilers call, and a panic handler.

use core::alloc::{GlobalAlloc, Layout};
use core::arch::{asm, global_asm};
use core::cell::UnsafeCell;
use core::fmt::{self, Write};
use core::sync::atomic::{AtomicUsize, Ordering};

/// The model file, embedded in the program.
static MODEL: &[u8] = include_bytes!(env!("ENTIRE_FREESTANDING_MODEL"));

// The kernel enters with the stack aligned to 16 bytes and no return address on it.
global_asm!(".globl _start", "_start:", "xor ebp, ebp", "and rsp, -16", "call {run}", "ud2", run = sym run);

extern "C" fn run() -> ! {
    let status = match entire_freestanding::report(MODEL, &mut Standard(1)) {
        Ok(()) => 0,
        Err(message) => {
            let _ = writeln!(Standard(2), "{message}");
            1
        }
    };
    exit(status)
}

fn system_call(number: usize, a: usize, b: usize, c: usize) -> isize {
    let result: isize;
    // SAFETY: the two system calls made here (write and exit) read only the memory that their caller passes.
    unsafe {
        asm!(
            "syscall",
            inlateout("rax") number as isize => result,
            in("rdi") a,
            in("rsi") b,
            in("rdx") c,
            out("rcx") _,
            out("r11") _,
            options(nostack)
        );
    }
    result
}

fn exit(status: usize) -> ! {
    loop {
        system_call(60, status, 0, 0);
    }
}

/// Standard output (1) or error (2).
struct Standard(usize);

impl Write for Standard {
    fn write_str(&mut self, text: &str) -> fmt::Result {
        let mut bytes = text.as_bytes();
        while !bytes.is_empty() {
            match usize::try_from(system_call(1, self.0, bytes.as_ptr() as usize, bytes.len())) {
                Ok(written) if written > 0 => bytes = &bytes[written..],
                _ => return Err(fmt::Error),
            }
        }
        Ok(())
    }
}

#[panic_handler]
fn panic(info: &core::panic::PanicInfo<'_>) -> ! {
    let _ = writeln!(Standard(2), "{info}");
    exit(101)
}

const ARENA_BYTES: usize = 64 << 20;

/// An arena that grows in one direction. Only the last piece can be freed.
#[repr(C, align(64))]
struct Arena {
    memory: UnsafeCell<[u8; ARENA_BYTES]>,
    used: AtomicUsize,
}

// SAFETY: the program has a single thread, so nothing is shared, and no two pieces overlap.
unsafe impl Sync for Arena {}

#[global_allocator]
static ARENA: Arena = Arena { memory: UnsafeCell::new([0; ARENA_BYTES]), used: AtomicUsize::new(0) };

// SAFETY: pieces are disjoint, lie inside the arena, and are aligned: the arena is aligned to 64 bytes.
unsafe impl GlobalAlloc for Arena {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let used = self.used.load(Ordering::Relaxed);
        let start = used.next_multiple_of(layout.align());
        match start.checked_add(layout.size()) {
            Some(end) if end <= ARENA_BYTES && layout.align() <= 64 => {
                self.used.store(end, Ordering::Relaxed);
                // SAFETY: the piece of `layout.size()` bytes from `start` on ends inside the arena.
                unsafe { self.memory.get().cast::<u8>().add(start) }
            }
            _ => core::ptr::null_mut(),
        }
    }

    unsafe fn dealloc(&self, piece: *mut u8, layout: Layout) {
        let start = piece as usize - self.memory.get() as usize;
        if start + layout.size() == self.used.load(Ordering::Relaxed) {
            self.used.store(start, Ordering::Relaxed);
        }
    }
}

// The compiler turns copies and fills into calls of the functions below. Inline `rep` instructions keep it
// from turning their own loops into such calls.

/// # Safety
/// The contract of the C function with this name.
#[unsafe(no_mangle)]
unsafe extern "C" fn memcpy(to: *mut u8, from: *const u8, count: usize) -> *mut u8 {
    // SAFETY: the caller guarantees `count` readable bytes at `from` and `count` writable bytes at `to`.
    unsafe {
        asm!("rep movsb", inout("rcx") count => _, inout("rdi") to => _, inout("rsi") from => _,
             options(nostack, preserves_flags));
    }
    to
}

/// # Safety
/// The contract of the C function with this name.
#[unsafe(no_mangle)]
unsafe extern "C" fn memmove(to: *mut u8, from: *const u8, count: usize) -> *mut u8 {
    if (to as usize).wrapping_sub(from as usize) >= count {
        // SAFETY: the caller guarantees `count` bytes at `from` and at `to`. `to` does not begin inside the
        // source, so no byte is overwritten before it is read.
        return unsafe { memcpy(to, from, count) };
    }
    // SAFETY: the caller guarantees `count` bytes at `from` and at `to`. In descending order, each byte is
    // read before it is overwritten. The direction flag is cleared again.
    unsafe {
        asm!("std", "rep movsb", "cld", inout("rcx") count => _,
             inout("rdi") to.wrapping_add(count).wrapping_sub(1) => _,
             inout("rsi") from.wrapping_add(count).wrapping_sub(1) => _, options(nostack));
    }
    to
}

/// # Safety
/// The contract of the C function with this name.
#[unsafe(no_mangle)]
unsafe extern "C" fn memset(to: *mut u8, value: i32, count: usize) -> *mut u8 {
    // SAFETY: the caller guarantees `count` writable bytes at `to`.
    unsafe {
        asm!("rep stosb", inout("rcx") count => _, inout("rdi") to => _, in("al") value as u8,
             options(nostack, preserves_flags));
    }
    to
}

/// # Safety
/// The contract of the C function with this name.
#[unsafe(no_mangle)]
unsafe extern "C" fn memcmp(a: *const u8, b: *const u8, count: usize) -> i32 {
    for i in 0..count {
        // Volatile reads keep the compiler from turning the loop into a call of this function.
        // SAFETY: the caller guarantees `count` readable bytes at `a` and at `b`.
        let (x, y) = unsafe { (a.add(i).read_volatile(), b.add(i).read_volatile()) };
        if x != y {
            return i32::from(x) - i32::from(y);
        }
    }
    0
}

/// # Safety
/// The contract of the C function with this name.
#[unsafe(no_mangle)]
unsafe extern "C" fn bcmp(a: *const u8, b: *const u8, count: usize) -> i32 {
    // SAFETY: the caller guarantees `count` readable bytes at `a` and at `b`.
    unsafe { memcmp(a, b, count) }
}

/// Rust's precompiled `core` and `alloc` refer to this symbol, but never call it: panics abort.
#[unsafe(no_mangle)]
extern "C" fn rust_eh_personality() {}

/// Rust's precompiled `core` and `alloc` refer to this symbol, but never call it: panics abort.
#[unsafe(no_mangle)]
extern "C" fn _Unwind_Resume() -> ! {
    exit(102)
}
