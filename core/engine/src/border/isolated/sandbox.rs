//! What a process of a plugin may do: compute. It opens no other program, no connection and no file but its libraries
//! and the files of its configuration, and has a limited address space.

use landlock::{
    ABI, Access, AccessFs, Ruleset, RulesetAttr, RulesetCreatedAttr, RulesetStatus, Scope, path_beneath_rules,
};
use libc::c_long;
use rustix::process::{Resource, Rlimit, setrlimit};
use seccompiler::{
    BpfProgram, SeccompAction, SeccompCmpArgLen, SeccompCmpOp, SeccompCondition, SeccompFilter, SeccompRule,
};
use std::path::{Path, PathBuf};

use crate::limits::ISOLATED_BYTES;

/// Where libraries of the system lie, which a library may need.
const LIBRARIES: [&str; 6] = ["/lib", "/lib64", "/usr/lib", "/usr/lib64", "/usr/local/lib", "/etc/ld.so.cache"];

/// Calls that nothing that computes needs. A list of what is denied has gaps where one of what is allowed would break
/// plugins: a kernel that takes calls of the x32 interface, which few do, takes these under other numbers.
const DENIED: &[c_long] = &[
    libc::SYS_socket,
    libc::SYS_socketpair,
    libc::SYS_connect,
    libc::SYS_bind,
    libc::SYS_listen,
    libc::SYS_accept,
    libc::SYS_accept4,
    libc::SYS_execve,
    libc::SYS_execveat,
    libc::SYS_ptrace,
    libc::SYS_process_vm_readv,
    libc::SYS_process_vm_writev,
    libc::SYS_pidfd_open,
    libc::SYS_pidfd_getfd,
    libc::SYS_kill,
    libc::SYS_tkill,
    libc::SYS_rt_sigqueueinfo,
    libc::SYS_rt_tgsigqueueinfo,
    libc::SYS_pidfd_send_signal,
    libc::SYS_mount,
    libc::SYS_umount2,
    libc::SYS_pivot_root,
    libc::SYS_chroot,
    libc::SYS_unshare,
    libc::SYS_setns,
    libc::SYS_bpf,
    libc::SYS_perf_event_open,
    libc::SYS_keyctl,
    libc::SYS_add_key,
    libc::SYS_request_key,
    libc::SYS_io_uring_setup,
    libc::SYS_userfaultfd,
    libc::SYS_memfd_create,
    libc::SYS_shmget,
    libc::SYS_mq_open,
    libc::SYS_open_by_handle_at,
    libc::SYS_setrlimit,
    // Landlock does not look at these.
    libc::SYS_fchmod,
    libc::SYS_fchmodat,
    libc::SYS_fchmodat2,
    libc::SYS_fchown,
    libc::SYS_fchownat,
    libc::SYS_utimensat,
    libc::SYS_setxattr,
    libc::SYS_lsetxattr,
    libc::SYS_fsetxattr,
    libc::SYS_removexattr,
    libc::SYS_lremovexattr,
    libc::SYS_fremovexattr,
    #[cfg(target_arch = "x86_64")]
    libc::SYS_chmod,
    #[cfg(target_arch = "x86_64")]
    libc::SYS_chown,
    #[cfg(target_arch = "x86_64")]
    libc::SYS_lchown,
    #[cfg(target_arch = "x86_64")]
    libc::SYS_utime,
    #[cfg(target_arch = "x86_64")]
    libc::SYS_utimes,
    #[cfg(target_arch = "x86_64")]
    libc::SYS_futimesat,
    #[cfg(target_arch = "x86_64")]
    libc::SYS_fork,
    #[cfg(target_arch = "x86_64")]
    libc::SYS_vfork,
];

/// Puts the calling thread, and all that it starts, behind the sandbox: the process must have no other. What this
/// kernel does not have of it is told.
///
/// # Errors
/// A limit cannot be set.
pub(super) fn enter(library: &Path, files: &[PathBuf]) -> std::io::Result<Vec<String>> {
    for (resource, limit) in
        [(Resource::As, ISOLATED_BYTES), (Resource::Fsize, ISOLATED_BYTES), (Resource::Core, 0), (Resource::Nofile, 64)]
    {
        setrlimit(resource, Rlimit { current: Some(limit), maximum: Some(limit) })?;
    }
    let mut lacking = Vec::new();
    // A plugin can run in any thread of its process, by a signal.
    if std::fs::read_dir("/proc/self/task").map_or(0, Iterator::count) != 1 {
        lacking.push("a process with one thread (its others may do what they like)".to_owned());
    }
    match restrict_files(library, files) {
        Ok(RulesetStatus::FullyEnforced) => {}
        Ok(RulesetStatus::PartiallyEnforced) => lacking.push("a part of Landlock".to_owned()),
        Ok(RulesetStatus::NotEnforced) => lacking.push("Landlock (it may read and write files)".to_owned()),
        Err(why) => lacking.push(format!("Landlock (it may read and write files): {why}")),
    }
    if let Err(why) = restrict_calls() {
        lacking.push(format!("seccomp (it may open connections and start programs): {why}"));
    }
    Ok(lacking)
}

fn restrict_files(library: &Path, files: &[PathBuf]) -> Result<RulesetStatus, landlock::RulesetError> {
    let abi = ABI::V6;
    // Libraries may lie beside the one that needs them.
    let folder = library.parent().map(Path::to_owned);
    let readable = LIBRARIES.iter().map(PathBuf::from).chain(folder).chain(files.iter().cloned());
    let status = Ruleset::default()
        .handle_access(AccessFs::from_all(abi))?
        .scope(Scope::from_all(abi))?
        .create()?
        .add_rules(path_beneath_rules(readable, AccessFs::from_read(abi)))?
        .restrict_self()?;
    Ok(status.ruleset)
}

fn restrict_calls() -> Result<(), Box<dyn std::error::Error>> {
    let deny = |rules, with: libc::c_int| {
        let errno = SeccompAction::Errno(with.unsigned_abs());
        let filter = SeccompFilter::new(rules, SeccompAction::Allow, errno, std::env::consts::ARCH.try_into()?)?;
        let program: BpfProgram = filter.try_into()?;
        Ok::<(), Box<dyn std::error::Error>>(seccompiler::apply_filter(&program)?)
    };
    let only_if = |argument, operator, value| {
        let condition = SeccompCondition::new(argument, SeccompCmpArgLen::Qword, operator, value)?;
        SeccompRule::new(vec![condition]).map(|rule| vec![rule])
    };
    let thread = u64::from(libc::CLONE_THREAD.unsigned_abs());
    let mut rules: std::collections::BTreeMap<c_long, Vec<SeccompRule>> =
        DENIED.iter().map(|n| (*n, Vec::new())).collect();
    // Threads are allowed, processes are not.
    rules.insert(libc::SYS_clone, only_if(0, SeccompCmpOp::MaskedEq(thread), 0)?);
    // A process may signal itself: that is how it aborts.
    let own = std::process::id().into();
    rules.insert(libc::SYS_tgkill, only_if(0, SeccompCmpOp::Ne, own)?);
    // Limits may be read, and not set.
    rules.insert(libc::SYS_prlimit64, only_if(2, SeccompCmpOp::Ne, 0)?);
    // The C library then falls back to `clone`, whose arguments a filter can see.
    deny([(libc::SYS_clone3, Vec::new())].into(), libc::ENOSYS)?;
    deny(rules, libc::EPERM)
}
