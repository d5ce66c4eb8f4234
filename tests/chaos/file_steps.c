/* Counts the calls by which this process changes files below a folder, and lets one of them go wrong.
 *
 * Loaded before libc (LD_PRELOAD), it stands before the calls of Python, Arrow and delta-rs alike, which is compiled
 * Rust. It does nothing until file_steps_arm() is called, and nothing in a process that is begun by another program.
 * See tests/chaos/file_steps.py. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <limits.h>
#include <signal.h>
#include <stdarg.h>
#include <stdatomic.h>
#include <stdio.h>
#include <string.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <sys/uio.h>
#include <unistd.h>

enum { NOTHING, KILLED, REFUSED, TORN };

static char under[PATH_MAX];
static long at;
static int how, told = -1;
static atomic_long steps;

/* Steps below `folder` are written to the open file `log`, a line each; step `number`, from 1, goes wrong. */
void file_steps_arm(const char *folder, long number, int fault, int log)
{
    snprintf(under, sizeof under, "%s/", folder);
    at = number, how = fault, told = log;
    atomic_store(&steps, 0);
}

static void absolute(int folder, const char *path, char *out)
{
    char link[64];
    out[0] = 0;
    if (path && path[0] == '/') {
        snprintf(out, PATH_MAX, "%s", path);
        return;
    }
    if (folder == AT_FDCWD)
        snprintf(link, sizeof link, "/proc/self/cwd");
    else
        snprintf(link, sizeof link, "/proc/self/fd/%d", folder);
    ssize_t n = syscall(SYS_readlinkat, AT_FDCWD, link, out, PATH_MAX - 1);
    out[n > 0 ? n : 0] = 0;
    if (path && n > 0)
        snprintf(out + n, PATH_MAX - n, "/%s", path);
}

static void die(void) { syscall(SYS_kill, syscall(SYS_getpid), SIGKILL); }

/* What becomes of a call on a path: NOTHING, REFUSED or TORN; KILLED does not return. */
static int step(const char *call, int folder, const char *path, size_t bytes)
{
    char where[PATH_MAX], line[PATH_MAX + 64];
    if (told < 0)
        return NOTHING;
    absolute(folder, path, where);
    if (strncmp(where, under, strlen(under)))
        return NOTHING;
    long number = atomic_fetch_add(&steps, 1) + 1;
    int n = snprintf(line, sizeof line, "%ld %s %zu %s\n", number, call, bytes, where + strlen(under));
    syscall(SYS_write, told, line, (size_t)n);
    if (how == TORN) /* the first write from there on */
        return number < at ? NOTHING : TORN;
    if (number != at)
        return NOTHING;
    if (how == KILLED)
        die();
    if (how == REFUSED)
        errno = EIO;
    return how;
}

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))
#define OR_FAILS(call, folder, path) if (step(call, folder, path, 0) == REFUSED) return -1

#define OPENS(name, head, folder, ...)                                                                               \
    int name head                                                                                                    \
    {                                                                                                                \
        mode_t mode = 0;                                                                                             \
        if (flags & (O_CREAT | __O_TMPFILE)) {                                                                       \
            va_list rest;                                                                                            \
            va_start(rest, flags);                                                                                   \
            mode = va_arg(rest, mode_t);                                                                             \
            va_end(rest);                                                                                            \
        }                                                                                                            \
        if (flags & (O_CREAT | O_TRUNC))                                                                             \
            OR_FAILS("open", folder, path);                                                                          \
        return REAL(name)(__VA_ARGS__, flags, mode);                                                                 \
    }
OPENS(open, (const char *path, int flags, ...), AT_FDCWD, path)
OPENS(open64, (const char *path, int flags, ...), AT_FDCWD, path)
OPENS(openat, (int folder, const char *path, int flags, ...), folder, folder, path)
OPENS(openat64, (int folder, const char *path, int flags, ...), folder, folder, path)

ssize_t write(int file, const void *data, size_t bytes)
{
    int fault = step("write", file, NULL, bytes);
    if (fault == REFUSED)
        return -1;
    if (fault == TORN) {
        syscall(SYS_write, file, data, bytes / 2);
        die();
    }
    return REAL(write)(file, data, bytes);
}

ssize_t pwrite64(int file, const void *data, size_t bytes, off64_t offset)
{
    int fault = step("write", file, NULL, bytes);
    if (fault == REFUSED)
        return -1;
    if (fault == TORN) {
        syscall(SYS_pwrite64, file, data, bytes / 2, offset);
        die();
    }
    return REAL(pwrite64)(file, data, bytes, offset);
}

ssize_t pwrite(int file, const void *data, size_t bytes, off_t offset)
{
    return pwrite64(file, data, bytes, offset);
}

/* Torn in the middle of its first part. */
ssize_t writev(int file, const struct iovec *parts, int n)
{
    int fault = step("write", file, NULL, n ? parts[0].iov_len : 0);
    if (fault == REFUSED)
        return -1;
    if (fault == TORN) {
        syscall(SYS_write, file, parts[0].iov_base, parts[0].iov_len / 2);
        die();
    }
    return REAL(writev)(file, parts, n);
}

int rename(const char *from, const char *path)
{
    OR_FAILS("rename", AT_FDCWD, path);
    return REAL(rename)(from, path);
}

int renameat(int a, const char *from, int b, const char *path)
{
    OR_FAILS("rename", b, path);
    return REAL(renameat)(a, from, b, path);
}

int renameat2(int a, const char *from, int b, const char *path, unsigned int flags)
{
    OR_FAILS("rename", b, path);
    return REAL(renameat2)(a, from, b, path, flags);
}

int link(const char *from, const char *path)
{
    OR_FAILS("link", AT_FDCWD, path);
    return REAL(link)(from, path);
}

int linkat(int a, const char *from, int b, const char *path, int flags)
{
    OR_FAILS("link", b, path);
    return REAL(linkat)(a, from, b, path, flags);
}

int unlink(const char *path)
{
    OR_FAILS("unlink", AT_FDCWD, path);
    return REAL(unlink)(path);
}

int unlinkat(int folder, const char *path, int flags)
{
    OR_FAILS("unlink", folder, path);
    return REAL(unlinkat)(folder, path, flags);
}

int rmdir(const char *path)
{
    OR_FAILS("rmdir", AT_FDCWD, path);
    return REAL(rmdir)(path);
}

int mkdir(const char *path, mode_t mode)
{
    OR_FAILS("mkdir", AT_FDCWD, path);
    return REAL(mkdir)(path, mode);
}

int mkdirat(int folder, const char *path, mode_t mode)
{
    OR_FAILS("mkdir", folder, path);
    return REAL(mkdirat)(folder, path, mode);
}

int fsync(int file)
{
    OR_FAILS("fsync", file, NULL);
    return REAL(fsync)(file);
}

int fdatasync(int file)
{
    OR_FAILS("fsync", file, NULL);
    return REAL(fdatasync)(file);
}

int ftruncate(int file, off_t bytes)
{
    OR_FAILS("truncate", file, NULL);
    return REAL(ftruncate)(file, bytes);
}

int ftruncate64(int file, off64_t bytes)
{
    OR_FAILS("truncate", file, NULL);
    return REAL(ftruncate64)(file, bytes);
}

ssize_t copy_file_range(int from, off64_t *a, int file, off64_t *b, size_t bytes, unsigned int flags)
{
    OR_FAILS("write", file, NULL);
    return REAL(copy_file_range)(from, a, file, b, bytes, flags);
}
