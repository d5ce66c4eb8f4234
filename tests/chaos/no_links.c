/* Below the folder NO_LINKS_BELOW there are neither hard links nor locks, as on mounts of object stores, exFAT and some
 * network shares. Loaded before libc (LD_PRELOAD) in a command and in what it begins. See tests/factory/test_no_links.py. */

#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <limits.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#define REAL(name) ((__typeof__(&name))dlsym(RTLD_NEXT, #name))

/* Paths of the project's commands are absolute. */
static int below(const char *path)
{
    const char *folder = getenv("NO_LINKS_BELOW");
    return folder && path && !strncmp(path, folder, strlen(folder)) && path[strlen(folder)] == '/';
}

int link(const char *from, const char *path)
{
    if (below(path)) {
        errno = EPERM;
        return -1;
    }
    return REAL(link)(from, path);
}

int linkat(int a, const char *from, int b, const char *path, int flags)
{
    if (below(path)) {
        errno = EPERM;
        return -1;
    }
    return REAL(linkat)(a, from, b, path, flags);
}

int flock(int file, int operation)
{
    char entry[64], path[PATH_MAX];
    snprintf(entry, sizeof entry, "/proc/self/fd/%d", file);
    ssize_t n = readlink(entry, path, sizeof path - 1);
    path[n > 0 ? n : 0] = 0;
    if (below(path)) {
        errno = ENOLCK;
        return -1;
    }
    return REAL(flock)(file, operation);
}
