//! The floating-point control word, which a plugin must leave as it was: a library that switches on flush-to-zero would
//! change every later result.

/// The control bits of the calling thread: rounding, flush-to-zero, exception masks; 0 where we cannot read them.
#[cfg(target_arch = "x86_64")]
pub(super) fn control_word() -> u32 {
    // Bits 0 to 5 are sticky exception flags and change freely.
    const CONTROL: u32 = 0xffc0;
    let mut word: u32 = 0;
    // SAFETY: stores the register into a local of the right size.
    unsafe { std::arch::asm!("stmxcsr [{}]", in(reg) &raw mut word, options(nostack, preserves_flags)) };
    word & CONTROL
}

/// Puts the control bits back.
#[cfg(target_arch = "x86_64")]
pub(super) fn restore(word: u32) {
    // SAFETY: loads a value that `control_word` read, its sticky flags clear.
    unsafe { std::arch::asm!("ldmxcsr [{}]", in(reg) &raw const word, options(nostack, readonly, preserves_flags)) };
}

#[cfg(target_arch = "aarch64")]
pub(super) fn control_word() -> u32 {
    let word: u64;
    // SAFETY: reads a register.
    unsafe { std::arch::asm!("mrs {}, fpcr", out(reg) word, options(nomem, nostack, preserves_flags)) };
    word as u32
}

#[cfg(target_arch = "aarch64")]
pub(super) fn restore(word: u32) {
    // SAFETY: writes a value that `control_word` read.
    unsafe { std::arch::asm!("msr fpcr, {}", in(reg) u64::from(word), options(nomem, nostack, preserves_flags)) };
}

#[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
pub(super) fn control_word() -> u32 {
    0
}

#[cfg(not(any(target_arch = "x86_64", target_arch = "aarch64")))]
pub(super) fn restore(_word: u32) {}
