/* A disk that is full, or a kill, at the nth write under a directory; loaded with LD_PRELOAD.

   FAULTS_DIR is the directory. FAULTS_STATE is a file that all processes map: they count in it
   together, and whoever started them says in it what is to happen, and when; see faults.py.
   FAULTS_LOG, unless it is empty, gets a line for every operation that counts. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

enum { NOTHING, FULL_ONCE, FULL_FROM, KILL };

static struct state {
    int64_t count, at, mode;
    char match[104]; /* only operations on paths with this in them count */
} *state;
static char dir[PATH_MAX];
static size_t dir_size;
static int log_file = -1;

__attribute__((constructor)) static void begin(void) {
    const char *where = getenv("FAULTS_DIR"), *shared = getenv("FAULTS_STATE");
    const char *log = getenv("FAULTS_LOG");
    if (where == NULL || shared == NULL) return;
    int file = syscall(SYS_openat, AT_FDCWD, shared, O_RDWR | O_CLOEXEC);
    if (file < 0) return;
    void *mapped = mmap(NULL, sizeof *state, PROT_READ | PROT_WRITE, MAP_SHARED, file, 0);
    syscall(SYS_close, file);
    if (mapped == MAP_FAILED) return;
    dir_size = strlen(where);
    memcpy(dir, where, dir_size + 1);
    if (log != NULL && *log)
        log_file = syscall(SYS_openat, AT_FDCWD, log, O_WRONLY | O_CREAT | O_APPEND | O_CLOEXEC, 0644);
    state = mapped;
}

/* What is to happen at an operation: 0, an error number, or, where `torn` can be, a kill after half
   of it. */
static int due(const char *operation, const char *path, int *torn) {
    if (state == NULL || strncmp(path, dir, dir_size)) return 0;
    if (path[dir_size] != '\0' && path[dir_size] != '/') return 0;
    if (state->match[0] && strstr(path + dir_size, state->match) == NULL) return 0;
    int64_t number = __atomic_add_fetch(&state->count, 1, __ATOMIC_SEQ_CST), at = state->at;
    if (log_file >= 0) {
        char line[PATH_MAX + 64];
        int size = snprintf(line, sizeof line, "%ld %s %s\n", (long)number, operation, path + dir_size);
        syscall(SYS_write, log_file, line, size);
    }
    if (state->mode == KILL && number == at) {
        if (torn == NULL) raise(SIGKILL);
        else *torn = 1;
    }
    int full = (state->mode == FULL_ONCE && number == at) || (state->mode == FULL_FROM && number >= at);
    return full ? ENOSPC : 0;
}

static int due_at_file(const char *operation, int file, int *torn) {
    if (state == NULL) return 0;
    char link[64], path[PATH_MAX];
    snprintf(link, sizeof link, "/proc/self/fd/%d", file);
    ssize_t size = syscall(SYS_readlinkat, AT_FDCWD, link, path, sizeof path - 1);
    if (size < 0) return 0;
    path[size] = '\0';
    return due(operation, path, torn);
}

static int due_at_name(const char *operation, int folder, const char *name) {
    if (state == NULL || name == NULL) return 0;
    char path[PATH_MAX];
    if (*name == '/') return due(operation, name, NULL);
    char link[64], base[PATH_MAX];
    if (folder == AT_FDCWD) strcpy(link, "/proc/self/cwd");
    else snprintf(link, sizeof link, "/proc/self/fd/%d", folder);
    ssize_t size = syscall(SYS_readlinkat, AT_FDCWD, link, base, sizeof base - 1);
    if (size < 0) return 0;
    base[size] = '\0';
    if (snprintf(path, sizeof path, "%s/%s", base, name) >= (int)sizeof path) return 0;
    return due(operation, path, NULL);
}

#define NEXT(name) \
    static __typeof__(&name) next; \
    if (next == NULL) next = (__typeof__(&name))dlsym(RTLD_NEXT, #name)
#define FAIL_IF(condition) \
    do { \
        int number_ = (condition); \
        if (number_) { \
            errno = number_; \
            return -1; \
        } \
    } while (0)

ssize_t write(int file, const void *data, size_t size) {
    NEXT(write);
    int torn = 0;
    FAIL_IF(due_at_file("write", file, &torn));
    if (torn) {
        next(file, data, size / 2);
        raise(SIGKILL);
    }
    return next(file, data, size);
}

ssize_t pwrite64(int file, const void *data, size_t size, off64_t begin) {
    NEXT(pwrite64);
    int torn = 0;
    FAIL_IF(due_at_file("pwrite", file, &torn));
    if (torn) {
        next(file, data, size / 2, begin);
        raise(SIGKILL);
    }
    return next(file, data, size, begin);
}

ssize_t pwrite(int file, const void *data, size_t size, off_t begin) {
    return pwrite64(file, data, size, begin);
}

ssize_t writev(int file, const struct iovec *parts, int count) {
    NEXT(writev);
    FAIL_IF(due_at_file("writev", file, NULL));
    return next(file, parts, count);
}

int fsync(int file) {
    NEXT(fsync);
    FAIL_IF(due_at_file("fsync", file, NULL));
    return next(file);
}

int fdatasync(int file) {
    NEXT(fdatasync);
    FAIL_IF(due_at_file("fdatasync", file, NULL));
    return next(file);
}

int ftruncate64(int file, off64_t size) {
    NEXT(ftruncate64);
    FAIL_IF(due_at_file("ftruncate", file, NULL));
    return next(file, size);
}

int ftruncate(int file, off_t size) { return ftruncate64(file, size); }

int posix_fallocate64(int file, off64_t begin, off64_t size) {
    NEXT(posix_fallocate64);
    int number = due_at_file("posix_fallocate", file, NULL);
    return number ? number : next(file, begin, size);
}

int posix_fallocate(int file, off_t begin, off_t size) { return posix_fallocate64(file, begin, size); }

/* Only what is made anew needs room. */
static int due_at_new(const char *operation, int folder, const char *name) {
    if (state == NULL || !syscall(SYS_faccessat, folder, name, F_OK)) return 0;
    return due_at_name(operation, folder, name);
}

int mkdirat(int folder, const char *name, mode_t mode) {
    NEXT(mkdirat);
    FAIL_IF(due_at_new("mkdir", folder, name));
    return next(folder, name, mode);
}

int mkdir(const char *name, mode_t mode) {
    NEXT(mkdir);
    FAIL_IF(due_at_new("mkdir", AT_FDCWD, name));
    return next(name, mode);
}

int renameat(int old_folder, const char *old_name, int folder, const char *name) {
    NEXT(renameat);
    FAIL_IF(due_at_name("rename", folder, name));
    return next(old_folder, old_name, folder, name);
}

int rename(const char *old_name, const char *name) {
    NEXT(rename);
    FAIL_IF(due_at_name("rename", AT_FDCWD, name));
    return next(old_name, name);
}

static int due_at_open(int folder, const char *name, int flags) {
    return flags & O_CREAT ? due_at_new("open", folder, name) : 0;
}

#define MODE(flags) \
    mode_t mode = 0; \
    if (flags & (O_CREAT | O_TMPFILE)) { \
        va_list rest; \
        va_start(rest, flags); \
        mode = va_arg(rest, mode_t); \
        va_end(rest); \
    }

int openat64(int folder, const char *name, int flags, ...) {
    NEXT(openat64);
    MODE(flags);
    FAIL_IF(due_at_open(folder, name, flags));
    return next(folder, name, flags, mode);
}

int openat(int folder, const char *name, int flags, ...) {
    MODE(flags);
    return openat64(folder, name, flags, mode);
}

int open64(const char *name, int flags, ...) {
    NEXT(open64);
    MODE(flags);
    FAIL_IF(due_at_open(AT_FDCWD, name, flags));
    return next(name, flags, mode);
}

int open(const char *name, int flags, ...) {
    MODE(flags);
    return open64(name, flags, mode);
}
