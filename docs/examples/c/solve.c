/* Solves what `petsc-fs convert` wrote: a MatNest with named blocks, vectors composed on them, and an options file. */
#include <petscksp.h>

static PetscErrorCode Open(const char *format, const char *name, PetscViewer *viewer)
{
  char folder[PETSC_MAX_PATH_LEN / 2] = "model1_petsc", path[PETSC_MAX_PATH_LEN], file[64];

  PetscFunctionBeginUser;
  PetscCall(PetscOptionsGetString(NULL, NULL, "-dir", folder, sizeof(folder), NULL));
  PetscCall(PetscSNPrintf(file, sizeof(file), format, name));
  PetscCall(PetscSNPrintf(path, sizeof(path), "%s/%s", folder, file));
  PetscCall(PetscViewerBinaryOpen(PETSC_COMM_WORLD, path, FILE_MODE_READ, viewer));
  PetscFunctionReturn(0);
}

int main(int argc, char **argv)
{
  const char *names[]    = {"contact", "intf_force", "momentum", "intf_flow", "mass"};
  const char *composed[] = {"fixed_stress_base", "fixed_stress_ratio"};
  Mat         A, J, block[25];
  Vec         b, x, r, part;
  IS          rows[5], all;
  VecScatter  scatter;
  KSP         ksp;
  PetscViewer viewer;
  MatInfo     info;
  PetscInt    i, j, its, dim = 2;
  PetscReal   residual, norm;

  PetscCall(PetscInitialize(&argc, &argv, NULL, NULL)); /* -options_file FILE -python */
  PetscCall(PetscOptionsGetInt(NULL, NULL, "-dim", &dim, NULL));
  PetscCall(Open("matrix.petsc", "", &viewer));
  PetscCall(MatCreate(PETSC_COMM_WORLD, &A));
  PetscCall(MatLoad(A, viewer));
  PetscCall(PetscViewerDestroy(&viewer));
  PetscCall(MatCreateVecs(A, NULL, &b));
  PetscCall(Open("rhs.petsc", "", &viewer));
  PetscCall(VecLoad(b, viewer));
  PetscCall(PetscViewerDestroy(&viewer));

  /* Rows of each field. The block size comes before the file, so that no cell is cut between ranks. */
  for (i = 0; i < 5; i++) {
    PetscCall(Open("fields/%s.petsc", names[i], &viewer));
    PetscCall(ISCreate(PETSC_COMM_WORLD, &rows[i]));
    PetscCall(ISSetType(rows[i], ISGENERAL));
    PetscCall(ISSetBlockSize(rows[i], i < 3 ? dim : 1));
    PetscCall(ISLoad(rows[i], viewer));
    PetscCall(PetscViewerDestroy(&viewer));
  }

  /* A block per pair of fields, NULL where it has no entry. Those on the diagonal carry the names. */
  for (i = 0; i < 5; i++) {
    for (j = 0; j < 5; j++) {
      PetscCall(MatCreateSubMatrix(A, rows[i], rows[j], MAT_INITIAL_MATRIX, &block[5 * i + j]));
      PetscCall(MatSetBlockSizes(block[5 * i + j], i < 3 ? dim : 1, j < 3 ? dim : 1));
      PetscCall(MatGetInfo(block[5 * i + j], MAT_GLOBAL_SUM, &info));
      if (i != j && info.nz_used == 0) PetscCall(MatDestroy(&block[5 * i + j]));
    }
    PetscCall(PetscObjectSetName((PetscObject)block[6 * i], names[i]));
  }
  for (i = 0; i < 2; i++) { /* What the fixed-stress approximation needs, on the block of pressure. */
    PetscCall(Open("fields/mass.%s.petsc", composed[i], &viewer));
    PetscCall(MatCreateVecs(block[24], NULL, &part));
    PetscCall(VecLoad(part, viewer));
    PetscCall(PetscViewerDestroy(&viewer));
    PetscCall(PetscObjectCompose((PetscObject)block[24], composed[i], (PetscObject)part));
    PetscCall(VecDestroy(&part));
  }
  PetscCall(MatCreateNest(PETSC_COMM_WORLD, 5, NULL, 5, NULL, block, &J));

  /* A vector of the nest has, on each rank, one field after the other. */
  PetscCall(MatCreateVecs(J, &x, &r));
  PetscCall(ISConcatenate(PETSC_COMM_WORLD, 5, rows, &all));
  PetscCall(VecScatterCreate(b, all, r, NULL, &scatter));
  PetscCall(VecScatterBegin(scatter, b, r, INSERT_VALUES, SCATTER_FORWARD));
  PetscCall(VecScatterEnd(scatter, b, r, INSERT_VALUES, SCATTER_FORWARD));

  PetscCall(KSPCreate(PETSC_COMM_WORLD, &ksp));
  PetscCall(KSPSetOperators(ksp, J, J));
  PetscCall(KSPSetFromOptions(ksp));
  PetscCall(KSPSolve(ksp, r, x));

  PetscCall(VecNorm(r, NORM_2, &norm));
  PetscCall(VecScale(r, -1));
  PetscCall(MatMultAdd(J, x, r, r));
  PetscCall(VecNorm(r, NORM_2, &residual));
  PetscCall(KSPGetIterationNumber(ksp, &its));
  PetscCall(PetscPrintf(PETSC_COMM_WORLD, "%d iterations, true relative residual %.1e\n", (int)its, (double)(residual / norm)));
  PetscCall(PetscFinalize());
  return 0;
}
