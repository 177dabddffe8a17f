/* Preloaded into a program, it makes the n-th call that writes into a folder of its choice fail, or ends the program
 * there.
 *
 * FAIL_UNDER  folder; only calls that name, or write to, something in it count
 * FAIL_AT     number of the call, from 1 on
 * FAIL_ERRNO  error number that it gives; 0 ends the program by SIGKILL
 * FAIL_ON     1: every later call fails too, as on a disk that is full
 * FAIL_COUNT  file into which the number of such calls goes when the program ends
 */
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/types.h>
#include <unistd.h>

static int counted;

static int setting(const char *name) {
    const char *text = getenv(name);
    return text ? atoi(text) : 0;
}

/* Whether this call, on a path, is to fail; errno is set then. */
static int fails(const char *path) {
    const char *folder = getenv("FAIL_UNDER");
    if (!folder || !path || !strstr(path, folder)) {
        return 0;
    }
    int call = __atomic_add_fetch(&counted, 1, __ATOMIC_SEQ_CST);
    int at = setting("FAIL_AT");
    if (!at || call < at || (call > at && !setting("FAIL_ON"))) {
        return 0;
    }
    if (!setting("FAIL_ERRNO")) {
        kill(getpid(), SIGKILL);
        for (;;) {
            pause();
        }
    }
    errno = setting("FAIL_ERRNO");
    return 1;
}

static int fd_fails(int fd) {
    char link[64], path[PATH_MAX];
    int saved = errno;
    snprintf(link, sizeof link, "/proc/self/fd/%d", fd);
    ssize_t length = readlink(link, path, sizeof path - 1);
    errno = saved;
    if (length <= 0) {
        return 0;
    }
    path[length] = 0;
    return fails(path);
}

static int at_fails(int folder, const char *name) {
    if (name && name[0] == '/') {
        return fails(name);
    }
    return folder == AT_FDCWD ? 0 : fd_fails(folder);
}

#define NEXT(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

ssize_t write(int fd, const void *bytes, size_t count) {
    return fd > 2 && fd_fails(fd) ? -1 : NEXT(write)(fd, bytes, count);
}
ssize_t pwrite(int fd, const void *bytes, size_t count, off_t at) {
    return fd_fails(fd) ? -1 : NEXT(pwrite)(fd, bytes, count, at);
}
ssize_t pwrite64(int fd, const void *bytes, size_t count, off64_t at) {
    return fd_fails(fd) ? -1 : NEXT(pwrite64)(fd, bytes, count, at);
}
int fsync(int fd) { return fd_fails(fd) ? -1 : NEXT(fsync)(fd); }
int fdatasync(int fd) { return fd_fails(fd) ? -1 : NEXT(fdatasync)(fd); }
int ftruncate64(int fd, off64_t length) { return fd_fails(fd) ? -1 : NEXT(ftruncate64)(fd, length); }
int link(const char *from, const char *to) { return fails(to) ? -1 : NEXT(link)(from, to); }
int linkat(int a, const char *from, int b, const char *to, int flags) {
    return at_fails(b, to) ? -1 : NEXT(linkat)(a, from, b, to, flags);
}
int rename(const char *from, const char *to) { return fails(to) ? -1 : NEXT(rename)(from, to); }
int mkdir(const char *path, mode_t mode) { return fails(path) ? -1 : NEXT(mkdir)(path, mode); }
int unlink(const char *path) { return fails(path) ? -1 : NEXT(unlink)(path); }
int unlinkat(int folder, const char *path, int flags) {
    return at_fails(folder, path) ? -1 : NEXT(unlinkat)(folder, path, flags);
}
int rmdir(const char *path) { return fails(path) ? -1 : NEXT(rmdir)(path); }

static int opens(const char *path, int flags) {
    return (flags & (O_CREAT | O_WRONLY | O_RDWR)) && fails(path);
}
int open(const char *path, int flags, ...) {
    va_list more;
    va_start(more, flags);
    mode_t mode = (flags & (O_CREAT | O_TMPFILE)) ? va_arg(more, mode_t) : 0;
    va_end(more);
    return opens(path, flags) ? -1 : NEXT(open)(path, flags, mode);
}
int open64(const char *path, int flags, ...) {
    va_list more;
    va_start(more, flags);
    mode_t mode = (flags & (O_CREAT | O_TMPFILE)) ? va_arg(more, mode_t) : 0;
    va_end(more);
    return opens(path, flags) ? -1 : NEXT(open64)(path, flags, mode);
}

__attribute__((destructor)) static void report(void) {
    const char *path = getenv("FAIL_COUNT");
    FILE *file = path ? fopen(path, "w") : NULL;
    if (file) {
        fprintf(file, "%d", counted);
        fclose(file);
    }
}
